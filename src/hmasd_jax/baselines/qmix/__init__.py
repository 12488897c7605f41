"""Value factorization with replay: VDN, QMIX and MASER, from the same pieces."""
