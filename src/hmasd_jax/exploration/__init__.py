"""Parts that help any on-policy algorithm to find and keep rare rewards."""
