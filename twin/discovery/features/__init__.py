"""Missing effects from published features: peaks, jumps, hysteresis, contact, impacts."""
