"""Linear systems, whatever they are of: sampling, responses, systems in parameters by name."""
