"""Detection and repair of wrong, missing and exchanged labels in control data."""
