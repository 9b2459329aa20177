"""What stands between a task and its implementation: parameter tables, validation, the CASA shell, the returned record.

Nothing else may import it but the tasks.
"""
