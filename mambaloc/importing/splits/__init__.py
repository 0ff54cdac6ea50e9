"""Train, validation and test splits: candidates, and which one is taken."""
