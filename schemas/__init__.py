"""What flows: the products, their columns, units and frames."""
