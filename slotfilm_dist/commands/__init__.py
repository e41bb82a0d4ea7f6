"""The commands of `slotfilm`, one module each; imported only when called."""
