"""The paper as a graph: tile x variant x stage, every node named by what makes it."""
