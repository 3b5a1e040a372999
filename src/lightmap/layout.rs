//! Layouts: where each chart lies in the pages of a map of a given resolution.
