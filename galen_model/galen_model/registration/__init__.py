"""Rigid transforms and the registration of a tracker."""
