"""The check of many recordings: which vehicles changed, when, and by how much."""
