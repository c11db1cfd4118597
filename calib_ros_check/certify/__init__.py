"""Certificates of data sets: is every calibration that comes with one right?"""
