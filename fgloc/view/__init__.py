"""Runs to look at, with rerun's viewer: live in a browser, or recorded in a file. Needs the extra ``view``."""
