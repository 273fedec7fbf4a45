"""Detection and repair of exchanged and wrong labels and of outliers in control data."""
