"""The built-in studies, as TOML files; `sweep list` names them."""
