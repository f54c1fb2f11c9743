"""Hostile input: made by hand (`hostile_bags`, `hostile_yaml`), by mutation (`mutate`), by hypothesis."""
