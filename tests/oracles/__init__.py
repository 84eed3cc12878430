"""Slow or independent implementations of parts of the package, with which tests compare it."""
