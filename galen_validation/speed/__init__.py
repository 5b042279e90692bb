"""Speed of nodes, kernels, start-up and recordings, each beside a baseline."""
