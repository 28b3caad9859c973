"""The seed paper: its statements, computed by the model and by a campaign."""
