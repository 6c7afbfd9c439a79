"""Inside the network: settings, features of a view, fused evaluation."""
