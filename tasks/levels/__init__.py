"""Roads above and below other roads: where levels begin, and what each of them sees."""
