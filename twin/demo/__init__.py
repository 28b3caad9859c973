"""The demonstration: an effect hidden at random, found and unsealed."""
