"""The only writers of results: artefacts, products, database and tables."""
