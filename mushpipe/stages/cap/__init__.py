"""The parts of `cap-fit`: sampling a cap's depth, fitting a spheroid to it, and judging the fit."""
