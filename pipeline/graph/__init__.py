"""The paper as a graph of tile x variant x stage; each node is identified by a fingerprint."""
