"""Kernels for NVIDIA GPUs in Warp, launched by `tumble.backends.cuda`; importing a file of this folder imports Warp."""
