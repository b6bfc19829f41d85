"""A recorded round to look at: in Rerun, or as one page of HTML."""
