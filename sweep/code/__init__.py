"""The user's code: loads it (`load`, `files`), and says what it is (`reach`)."""
