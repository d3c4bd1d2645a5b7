"""What every other part of the package uses: rules on arguments, and files that are written whole or not at all."""
