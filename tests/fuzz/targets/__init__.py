"""What is fuzzed: each module makes valid files in a folder, and reads one of them.

``make(folder)`` returns the files, ``read(path)`` reads one. Optional: ``copy(path, folder)`` copies a file
and what belongs to it, ``change(path, data, rng)`` returns a damaged copy, empty for random damage.
"""
