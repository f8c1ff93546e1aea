"""The stepping debugger: a session of commands that move through a run, look inside it, change it, and go on."""
