"""The simulator: a batch of environments, its buffers in torch's graph, the launches of the kernels."""
