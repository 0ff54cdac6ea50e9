"""Checks of a capture's frames, poses and conventions, before it becomes a scene."""
