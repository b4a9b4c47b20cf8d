"""The whole loop on a virtual ship: what `greybox demo` runs, tells and draws."""
