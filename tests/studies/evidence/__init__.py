"""The study of evidence: recordings of laboratories that share no code with the product."""
