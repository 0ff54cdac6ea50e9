"""Structure from motion, for captures without poses."""
