"""What it means: recording -> dataset -> regressor -> base parameters -> estimate -> report."""
