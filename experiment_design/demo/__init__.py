"""The whole loop on a virtual ship, which `greybox demo` runs, reports and draws."""
