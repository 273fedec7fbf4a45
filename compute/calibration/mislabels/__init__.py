"""Wrong, missing and exchanged labels in control data: found, named, and mended on request."""
