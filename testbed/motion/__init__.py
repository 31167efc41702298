"""What really happens: flown, from a formula, or laid out along segments; on ticks, as truth blocks."""
