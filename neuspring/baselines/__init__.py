"""The systems that the paper compares with, as models of their own: Spring-Gaus, GS-Dynamics, and two that learn nothing.

PhysTwin is no file here: it is a row of the method table, made of the platform's own search and fit.
"""
