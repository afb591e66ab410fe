"""humanoid"""
