"""Runnable experiments: how well, how soon and how steadily policies learn. Run them from the root folder."""
