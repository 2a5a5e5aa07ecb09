"""Roads above and below other roads: where levels begin, and which heights belong to each level."""
