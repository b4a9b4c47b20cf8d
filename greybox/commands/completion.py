"""`greybox completion`: the script that lets a shell complete what is typed."""

from __future__ import annotations

import argparse

from greybox.commands.common import say

HELP = "print the script that makes Tab complete commands, options, names and files"
EXAMPLES = """examples:
  greybox completion bash
  greybox completion zsh
  greybox completion fish

to install it, for this shell only and for those to come:
  bash    eval "$(greybox completion bash)"
          greybox completion bash >> ~/.bash_completion
  zsh     eval "$(greybox completion zsh)"
          echo 'eval "$(greybox completion zsh)"' >> ~/.zshrc     (after compinit)
  fish    greybox completion fish | source
          greybox completion fish > ~/.config/fish/completions/greybox.fish
"""
SHELLS = ("bash", "zsh", "fish")
_COMMENTS = {
    "bash": ('eval "$(greybox completion bash)"', "greybox completion bash >> ~/.bash_completion"),
    "zsh": (
        'eval "$(greybox completion zsh)"',
        "echo 'eval \"$(greybox completion zsh)\"' >> ~/.zshrc",
    ),
    "fish": (
        "greybox completion fish | source",
        "greybox completion fish > ~/.config/fish/completions/greybox.fish",
    ),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("shell", choices=SHELLS, help="the shell to complete in")


def run(options: argparse.Namespace) -> None:
    """Print the script, with how to install it as its last lines."""
    from argcomplete.shell_integration import shellcode

    now, ever = _COMMENTS[options.shell]
    script = shellcode(["greybox"], use_defaults=False, shell=options.shell)
    say(f"{script.rstrip()}\n\n# in this shell only:  {now}\n# in those to come:    {ever}")
