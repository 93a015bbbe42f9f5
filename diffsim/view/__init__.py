"""Pictures, videos, windows and web pages of robots, and what their gait looks like in numbers."""
