"""The parts of `phase-hough`: edges, votes, refits, features, and the decision cap by cap."""
