"""Regressions and instruments, formed from symbolic derivatives."""
