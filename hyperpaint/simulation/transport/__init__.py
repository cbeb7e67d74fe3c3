"""Light transport: geometry, surfaces, and the recorder of paths."""
