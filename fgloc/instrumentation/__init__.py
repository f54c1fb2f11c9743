"""Where the time of a run goes, and how far long work has come."""
