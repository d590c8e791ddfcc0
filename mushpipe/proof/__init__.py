"""A replay that proves itself: comparing results, and measuring what a graph costs."""
