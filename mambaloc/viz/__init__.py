"""Plots, each file imported by its name: some need torch or plotly, others neither."""
