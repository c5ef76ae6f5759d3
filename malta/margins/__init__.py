"""What `malta verify` reports of a design: margins over the travel, stage by stage; poles, peaks and bandwidths."""
