"""The answer: gap, localization, parameters, sentence."""
