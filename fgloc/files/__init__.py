"""Files of the user: guarded reading of documents and settings; results that are whole, or the old ones."""
