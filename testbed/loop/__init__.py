"""The run itself: feed, estimators, record and links in one loop, and what may be asked of it."""
