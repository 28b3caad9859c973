"""The model alone on the drive of a test or a campaign, with one model or many, at many gaps."""
