"""What fits the tables that are shipped: run when a material or a method changes, by who maintains the package."""
