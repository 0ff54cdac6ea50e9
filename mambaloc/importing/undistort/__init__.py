"""Images without lens distortion."""
