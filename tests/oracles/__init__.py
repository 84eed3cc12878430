"""Slow or second ways to compute what the package computes, to hold it against."""
