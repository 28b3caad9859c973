"""The model beside the rig: predicts, compares, learns, streams."""
