"""Which of several explanations a recording shows: evidence of sets of effects, once."""
