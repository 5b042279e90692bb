"""Long runs that compare every stamp and watch memory."""
