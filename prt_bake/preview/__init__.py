"""The preview window: `lights`, `state` and `colours` say what is shown and need no VTK, `window` shows it."""
