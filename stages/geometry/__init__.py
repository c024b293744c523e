"""Pure numerics that several stages share."""
