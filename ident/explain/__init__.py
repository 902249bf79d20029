"""What physics a model leaves out: located, named, modelled and shown on motion it has not seen."""
