"""A workflow of small products and stages, to try the engine without real ones. Workers import it by name."""
