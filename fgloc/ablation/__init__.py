"""Ablation: failures of sensors as filters of events, swept over recordings and variants."""
