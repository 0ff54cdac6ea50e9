"""Readers: one file per capture format, and what they share."""
