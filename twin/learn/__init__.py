"""What explains the difference between model and measurement: identify, discover."""
