"""Capture a function into a CUDA graph; on the CPU there is nothing to capture."""
