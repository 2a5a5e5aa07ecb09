"""Show how a run goes: progress, states, alerts."""
