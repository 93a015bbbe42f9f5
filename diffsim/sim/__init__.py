"""How a control step is taken: the batch of environments, its buffers in torch's graph, the launches of the kernels."""
