"""Measurements of the project: speed, studies behind the figures in docs/, long runs, drives with events."""
