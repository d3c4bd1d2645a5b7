"""The paper's method: Algorithms 1 and 2, and the offline training of a policy."""
