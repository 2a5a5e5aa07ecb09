"""Storage of results: artefacts, products, database and tables; no other package writes them."""
