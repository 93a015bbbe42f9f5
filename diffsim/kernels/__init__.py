"""Warp kernels of one control step and of its adjoint, generated for one scene; see forward.py and backward.py."""
