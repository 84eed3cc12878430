"""Kernels outside of rendering: depth fusion and texture baking of the export, bundle adjustment of stage 1."""
