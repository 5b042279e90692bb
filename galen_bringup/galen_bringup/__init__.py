"""Launch files, configuration and the demonstration of the Galen suite."""
