"""Parts that several learners share and others lack."""
