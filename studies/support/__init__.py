"""What studies share: campaigns of trials, hold-outs, and what the papers and others did."""
