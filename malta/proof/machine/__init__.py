"""The model of a machine in its parameters: plant, preload and windings, as a proof takes them."""
