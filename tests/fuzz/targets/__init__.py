"""What is fuzzed: each module makes valid files in a folder, and reads one of them."""
