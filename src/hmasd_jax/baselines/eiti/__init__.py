"""EITI and EDTI (Wang et al., ICLR 2020), which share networks, counts and learner."""
