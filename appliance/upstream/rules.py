"""What a link carries, and under which topic: rules, answers, loops, limits of kinds of broker."""
