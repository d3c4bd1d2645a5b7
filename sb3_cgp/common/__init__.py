"""What the other packages share: rules on arguments, spaces, networks, random states, files written whole or not at all."""
