"""Box rooms and a virtual robot cell, with exact poses."""
