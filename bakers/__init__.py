"""From something that answers Ŝ to coefficients; the mathematics is handed in as callables and arrays."""
