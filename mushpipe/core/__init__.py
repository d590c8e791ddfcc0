"""The framework: types, stages, graph, plugins and the loop that runs them."""
