"""What the loss of each sensor costs: failures as filters of events, swept over recordings and variants."""
