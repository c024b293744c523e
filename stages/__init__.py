"""How each product is computed: pure functions, one stage a module."""
