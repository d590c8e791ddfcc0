"""Beds by another renderer: shapes, soil, paint, lamps and cameras of their own, path traced.

They share with `mushpipe.sim` the rules of what counts and plain tools, such as the curve of sRGB;
nothing was trained on them, and of four networks one was preferred with a look at them. They tell
how far figures of simulated scenes can be trusted:
`python -m training.traced` renders them with Mitsuba 3 (Jakob et al. 2022) into recordings with
truth, `mushpipe eval` holds graphs against these.

Order of the modules: `mesh`, `things`, `bed`, `render`, `cameras`, `truth`, `__main__`. Lengths are
metres; the bed frame has z up and z = 0 on the mean bed.
"""
