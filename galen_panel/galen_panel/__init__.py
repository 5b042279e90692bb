"""The operator's panel in the browser: tools, behaviours, compensation, live plots, recordings."""
