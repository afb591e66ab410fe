"""Motion clips that ship with egopose; see NOTICE.md beside this file."""
