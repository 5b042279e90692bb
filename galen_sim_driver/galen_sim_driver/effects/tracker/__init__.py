"""Effects of the tracker."""
