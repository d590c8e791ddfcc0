"""The built-in stages, one module each, numeric kernels beside them or in `cap` and `phase`."""
