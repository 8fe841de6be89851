"""Extensions: what only the command line imports. README.md here says how one is left out, and how packages add others."""
