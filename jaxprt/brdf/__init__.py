"""brdf."""
