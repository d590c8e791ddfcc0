"""The simulated mushroom bed behind the source `synthetic`."""
