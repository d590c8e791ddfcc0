"""The built-in stages, one module each, numeric kernels beside them."""
