"""What happens to many tiles: configuration, graph, store, execution, report, command line."""
