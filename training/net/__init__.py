"""Training of `cap-net`, the small learned detector, from simulated frames alone."""
