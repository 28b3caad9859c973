"""Digital twin of the specimen: predicts, compares, identifies, records, streams."""
