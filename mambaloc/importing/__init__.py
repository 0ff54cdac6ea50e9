"""Anyone's capture as a scene: readers of other tools' formats, one canonical folder, a report of what was found."""
